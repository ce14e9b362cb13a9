"""First-person semantic segmentation, which semantic mapping projects by depth: the paper's baseline."""
