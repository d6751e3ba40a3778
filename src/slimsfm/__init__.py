"""slimsfm: make a Structure-from-Motion model small and localizing in it fast, and know what that costs."""
