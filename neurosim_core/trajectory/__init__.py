"""Where the vehicle flies: paths, and what makes them."""
