/* The rover's Arduino: ../README.md says what it does, on which pins, and what it is told over the serial line. */
#include "board.h"

static struct vehicle vehicle;
static struct reader reader;
static struct line line;
static bool hello_due, status_due;
static uint32_t status_ms;

static const uint16_t STATUS_MS = 20;

void setup() {
  const struct car *car = car_kept();
  pulses_begin(car);
  vehicle_start(&vehicle, boot_number(), car);
  receiver_begin();
  serial_begin();
  serial_put("\n", 1);  /* ends a line that a reset cut, so that the hello is whole */
  watchdog_begin();
  hello_due = true;
}

/* Returns whether the byte ended a line, because reading a line is enough work for one turn of the loop. */
static bool take(uint8_t byte, uint32_t now_ms) {
  struct command command;
  switch (reader_take(&reader, byte, now_ms, &command)) {
    case READ_COMMAND:
      if (command.kind == COMMAND_HELLO) {
        hello_due = true;
      } else {
        vehicle_command(&vehicle, &command, now_ms);
        status_due = status_due || command.kind != COMMAND_STICKS;  // sticks answer a status: it would never end
      }
      return true;
    case READ_BAD:
      count(&vehicle.bad_lines);
      return true;
    case READING:
      break;
  }
  return false;
}

void loop() {
  uint32_t now_ms = clock_ms();
#ifndef HUMAN_GAMEPAD  // with it, nothing is on the receiver's pins
  uint16_t pulse_us, period_us;
  if (receiver_take(STEERING, &pulse_us, &period_us)) vehicle_received(&vehicle, STEERING, pulse_us, period_us, now_ms);
  if (receiver_take(THROTTLE, &pulse_us, &period_us)) vehicle_received(&vehicle, THROTTLE, pulse_us, period_us, now_ms);
#endif
  int byte;
  bool read = false;
  for (uint8_t n = 0; n < 32 && !read && (byte = serial_take()) >= 0; n++) read = take((uint8_t)byte, now_ms);
  for (uint8_t lost = serial_lost(); lost; lost--) count(&vehicle.lost_bytes);
  vehicle_tick(&vehicle, now_ms);
  pulses_set(&vehicle.car, vehicle.steering_us, vehicle.throttle_us);
  if (vehicle_may_keep(&vehicle)) car_keep(&vehicle.car);

  /* Each turn of the loop reads a line, sends a hello or sends a status, but only one of these. A line without room is sent
   in a later turn, a status with the values of then. */
  if (!read && hello_due) {
    if (serial_put(line.text, vehicle_hello(&vehicle, reset_cause(), &line))) hello_due = false;
  } else if (!read && (status_due || now_ms - status_ms >= STATUS_MS)) {
    if (serial_put(line.text, vehicle_status(&vehicle, now_ms, &line))) {
      status_due = false;
      status_ms = now_ms;
    }
  }
  watchdog_feed();
  rest();
}
