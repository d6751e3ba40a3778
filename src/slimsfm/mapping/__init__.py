"""Maps: what they are, how they are read, written, built, imported and cut down to some images."""
