"""Synthetic walkers, multi_limb and the ground they walk on."""
