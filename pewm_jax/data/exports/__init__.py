"""Episodes in the formats of other tools: LeRobot, RLDS, Rerun, point clouds, videos."""
