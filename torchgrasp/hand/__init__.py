"""How this hand can touch: kinematics, collision, the learned posture model, refinement."""
