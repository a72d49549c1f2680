"""Chapter 1, where the camera is: cameras, actions → poses, Plücker rays, unprojection."""
