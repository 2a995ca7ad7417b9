"""Power flow of the line with the GUPFC: injected powers, Newton's method, all operating points."""
