"""What passes between folders: clouds, contacts, grasps, closings, options of users. Not public."""
