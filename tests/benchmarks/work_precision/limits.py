"""What limits the scenes whose targets are not met, and what was tried. Shown in the report beside the missing factor."""

LIMITS: dict[str, str] = {}
