"""Textured objects with exact ground truth: shapes, prints, scenes, camera paths and a ray caster."""
