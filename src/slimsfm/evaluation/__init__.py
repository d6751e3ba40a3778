"""Localize queries with known poses against maps, score the results and write them to disk."""
