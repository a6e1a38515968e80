"""How a closed hand presses: with balanced forces, or with the least that carry what is felt. Not public."""
