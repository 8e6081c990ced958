"""Where things are in the record of a projected Gaussian.

A record is `HEAD` floats and then the planes (features, depth, zeros), see `Layout.record`. Its exponent is kept in
powers of two: log2(alpha) = LOG2_OPACITY + XX dx² + XY dx dy + YY dy² with (dx, dy) = pixel - centre.
"""

HEAD = 8
CENTER_X, CENTER_Y, XX, XY, YY, LOG2_OPACITY, HALF_WIDTH, HALF_HEIGHT = range(HEAD)  # px, 1/px²
