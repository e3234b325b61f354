"""World files that come with mavfi."""
