"""What is known of the side that the camera did not see."""
