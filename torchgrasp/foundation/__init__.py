"""What every other folder builds on, without robotics: errors, checks of arguments, values,
processes, limits.
"""
