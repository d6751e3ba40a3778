"""Localizing queries of known pose against maps, and what comes of it."""
