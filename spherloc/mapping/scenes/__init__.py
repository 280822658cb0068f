"""What is written of a map: scenes of its images and of new ones, and how new ones are judged together."""
