"""Bytes to records and back. Pure; every decoder decodes or raises `CodecError`."""
