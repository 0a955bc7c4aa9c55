"""From flights to the named physical effect a model lacks."""
