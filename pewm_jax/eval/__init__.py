"""Chapter 9, how good it is: protocol, image errors, seen-before masks, scores, report."""
