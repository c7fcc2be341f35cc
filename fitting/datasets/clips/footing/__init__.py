"""How feet move while they stand: noise that shakes them, and a slide of the whole character."""
