"""The hands and their posture models, beside their bars."""
