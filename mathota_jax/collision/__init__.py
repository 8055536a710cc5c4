"""Finding contacts: which features of two shapes are closest, and how far apart they are."""
