"""Synthetic walkers, crawlers and the ground they walk on."""
