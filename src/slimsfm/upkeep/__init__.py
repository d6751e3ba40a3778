"""Keep a map right and up to date: check and align it, add photos, merge maps, forget what is not needed."""
