"""How a run ends, what it leaves behind, and that it goes on from there."""
