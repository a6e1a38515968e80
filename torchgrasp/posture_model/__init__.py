"""The learned posture model: a Gaussian mixture over contacts and joints (Sec. 4)."""
