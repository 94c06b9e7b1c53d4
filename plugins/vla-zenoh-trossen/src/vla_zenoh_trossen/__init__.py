"""Trossen's WidowX AI arms by the maker's library, for vla-zenoh."""
