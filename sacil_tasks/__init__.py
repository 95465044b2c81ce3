"""Size-sensitive manipulation tasks for ManiSkill 3."""
