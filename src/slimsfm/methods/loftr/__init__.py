"""LoFTR: maps and matches without a keypoint detector."""
