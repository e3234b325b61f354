"""Shipped world files."""
