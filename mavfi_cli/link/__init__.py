"""The MAVLink side: transports, codec, signing, the offboard session, images and the .tlog."""
