"""Closing on it: the compliant law, the desired forces and the controllers, without a simulator."""
