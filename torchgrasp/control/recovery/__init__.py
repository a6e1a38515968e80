"""What a hand does that touches something on its way, or closed in vain: it finds the object and goes there."""
