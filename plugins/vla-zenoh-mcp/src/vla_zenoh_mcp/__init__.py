"""A server of the Model Context Protocol: agents drive a robot by its guarded motions."""
