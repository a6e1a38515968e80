"""A hand that touches something on its way, or closed in vain, finds the object and goes there. Not public."""
