"""Keep a map right and up to date: check its poses, align it to units and places, add, merge, forget."""
