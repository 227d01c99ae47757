"""What the packages of this repository share without torch: command lines, errors, files."""
