"""The model kit: what plants and laws are made of; integrators, histories, linear algebra, compiled steps."""
