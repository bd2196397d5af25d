"""Case study, reports and command line of flexarm."""
