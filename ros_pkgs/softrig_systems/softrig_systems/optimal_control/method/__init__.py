"""Methods: modified variational iteration on power series, direct collocation, exactly known least costs."""
