"""What models that query another policy server share, and vla-zenoh-serve, which answers as one.

For model environments: numpy, msgpack, msgspec, pydantic and pyyaml are enough to import it.
"""
