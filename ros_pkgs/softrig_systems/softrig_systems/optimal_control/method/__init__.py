"""Methods: modified variational iteration on power series, direct collocation, least costs that are known exactly."""
