"""What a scene is, as data, without a simulator: postures, suit, rocks, terrain, target areas, splits (P8)."""
