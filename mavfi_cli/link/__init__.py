"""MAVLink: transports, codec, signing, the offboard session, images and the .tlog."""
