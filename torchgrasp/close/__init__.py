"""Closing on it: the compliant law, the desired forces, and a simulated trial."""
