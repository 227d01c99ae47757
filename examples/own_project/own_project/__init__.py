"""Terms, tiles and networks of one's own; a configuration names them by their dotted paths."""
