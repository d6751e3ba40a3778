"""OnePose++: matches map points with the cells of a query by attention, without keypoints."""
