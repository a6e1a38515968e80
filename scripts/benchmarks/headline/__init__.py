"""What README says, measured at one commit."""
