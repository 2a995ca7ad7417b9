"""The model kit for plants and controllers: integrators, histories, linear algebra, compiled steps."""
