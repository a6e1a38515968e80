"""The values that pass between folders: clouds, contacts, grasps; closings; and the options of
users.
"""
