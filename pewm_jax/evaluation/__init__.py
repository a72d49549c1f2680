"""Chapter 9, how good it is: images, seen-before masks, protocol, scores, report."""
