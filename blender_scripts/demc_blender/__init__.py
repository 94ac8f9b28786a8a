"""What export_passes.py and generate_scenes.py share: passes, the position AOV, rendering, names."""
