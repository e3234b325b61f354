"""The same missions on several computers: `mavfi compare`.

`plan` says which missions: a campaign, as the preset fig16 is one. `fly` flies them, and a golden
flight a platform for the timeline. `flights` is what each came to, `figures` what that says about
platforms, `costs` what faults cost on each and the worst cases, `timeline` which kernel ran when
between a frame and its setpoint, `table` the text, `rows` the CSV.
"""
