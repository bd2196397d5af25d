"""Fast control laws: what damps the bending around its quasi-steady state. One law per file."""
