"""How good a new view is, judged without ground truth: what to expect of it, and whether it is kept."""
