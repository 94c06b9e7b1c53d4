"""Camera sources, one kind a file, and the publisher of their images.

A new kind needs a file here, a branch in `node.make_source`, and its scheme in
`vla_zenoh.profile.schema.CAMERA_SOURCES`.
"""
