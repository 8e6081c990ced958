"""How far pictures are from the true ones, and the protocols by which reconstructions are compared."""
