"""OnePose: matches query keypoints with map points by graph attention."""
