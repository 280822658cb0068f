"""Between browser and page: the front door, viser's page with our script, and all that leans on its insides."""
