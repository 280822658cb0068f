"""Between browser and page: the front door, viser's page with our script, and what depends on viser's internals."""
