"""Flip one bit of a planned waypoint and compare the flight with its golden pair."""

import mavfi_cli as mavfi

fault = mavfi.FaultConfig(target="waypoint_y", field="exponent")
run = mavfi.fly(world="farm", seed=5, start=(2, 2, 0), goal=(10, 6, 5), fault=fault)
golden = mavfi.paired_golden(run)
for name, flight in (("golden", golden), ("faulty", run)):
    flown_s = flight.result["quality_of_flight"]["flight_time_s"]
    print(f"{name}: {flight.result['outcome']} after {flown_s:.1f} s")
for strike in run.result["fault"]["strikes"]:
    for change in strike["changes"]:
        print(f"{change['state']}: {change['before']} -> {change['after']}")
