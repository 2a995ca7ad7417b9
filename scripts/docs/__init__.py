"""The pages of the packages as one site: collected, completed by what the code says of itself, built by Sphinx."""
