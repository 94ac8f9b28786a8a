"""Seeded random scenes for training: assets, materials, shapes, kinds of scenes, crops."""
