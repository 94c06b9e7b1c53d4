"""Certificates, roles and access rules of a lab. Pure."""
