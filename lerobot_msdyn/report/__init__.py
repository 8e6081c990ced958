"""A page to look at: what was recorded, what was rendered from it, how good it is, what was left out and why."""
