"""Active queue management: N TCP flows on one bottleneck, as a delay equation and packet by packet."""
