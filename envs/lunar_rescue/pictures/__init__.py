"""Pictures of a scene: shapes, regolith, rendering and what is drawn over it."""
