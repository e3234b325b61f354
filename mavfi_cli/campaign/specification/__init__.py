"""Specifications of campaigns: campaign.toml, presets and factors."""
