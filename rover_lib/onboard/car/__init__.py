"""The car and its devices: servo pulses, the Arduino, the camera, and car.yml, which describes them."""
