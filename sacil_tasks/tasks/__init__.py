"""The tasks, one file each; the file name is the name on command lines."""
