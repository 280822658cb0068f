"""Panels about single matches: the card, the table and the images."""
