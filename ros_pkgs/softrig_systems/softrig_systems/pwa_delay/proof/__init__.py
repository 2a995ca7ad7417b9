"""Proofs of stability: criteria as matrix inequalities, certificates checked from their matrices, where they apply."""
