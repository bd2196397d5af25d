"""What the nodes of flexarm share."""
