"""Search methods of the papers, named after animals; published results are compared with them."""
