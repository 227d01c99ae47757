"""The evidence: speed against error, and what features cost."""
