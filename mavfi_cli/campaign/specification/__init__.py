"""What a campaign is to fly: campaign.toml, presets, factors; written down, changed, compared."""
