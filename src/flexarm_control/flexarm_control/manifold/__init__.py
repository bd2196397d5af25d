"""Slow manifolds: where the deflections belong while the slow motion goes on. One manifold per file."""
