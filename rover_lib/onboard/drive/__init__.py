"""Drive: the control loop, the plans that it follows, the service around it, and the flight log."""
