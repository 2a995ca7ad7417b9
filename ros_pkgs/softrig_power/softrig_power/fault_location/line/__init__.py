"""The line with its fault: parameters, equations of the network, the measurement chain, its simulation."""
