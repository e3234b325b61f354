"""Campaigns: planned lists of missions with a ledger of their results."""
