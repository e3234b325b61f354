"""The same missions on several computers: `mavfi compare`.

    plan      which missions: a campaign, as the preset fig16 is one
    fly       flies them, and a golden flight a platform for the timeline
    flights   what each flight came to
    figures   settings, ratios of platforms, worst cases
    timeline  which kernel ran when between a frame and its setpoint
    table     all of it as text and as CSV
"""
