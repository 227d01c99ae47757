"""Networks that read histories of sampled points."""
