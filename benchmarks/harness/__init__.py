"""What all studies share: timer, tables, Pareto fronts, float64 reference, rotations, meshes, figures, command line."""
