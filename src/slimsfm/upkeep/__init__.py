"""Keep a map right and up to date: check its poses, align it to unit and place, add photos, merge, forget."""
