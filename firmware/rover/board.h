/* What the ATmega328P does by hardware: pulses out, pulses in, serial line, watchdog. ../README.md has the pins. */
#ifndef ROVER_BOARD_H
#define ROVER_BOARD_H

#include "vehicle.h"

/* The car that was told before a reset which left the memory's power on, or else the default. */
const struct car *car_kept();
void car_keep(const struct car *car);

/* A car's neutral pulses on both pins. The first thing that setup() does. */
void pulses_begin(const struct car *car);
/* What the pins do from their next pulse on, that of another car once no pulse is on. Anything that no servo of it should
 * see becomes neutral. Call it every 2 ms. */
void pulses_set(const struct car *car, uint16_t steering_us, uint16_t throttle_us);

/* The receiver's pulses, and the clock. */
void receiver_begin();
/* Milliseconds since receiver_begin(), wraps at 32 bits. Not millis(): the core's Timer0 is off. Call it more often than
 * every half hour. */
uint32_t clock_ms();
/* Whether a whole pulse came on the channel since the last call; if so, how long it and its period were. */
bool receiver_take(enum channel channel, uint16_t *pulse_us, uint16_t *period_us);

void serial_begin();
/* The next byte of the host, or -1. */
int serial_take();
/* Queues all of a line, or nothing of it if there is no room. */
bool serial_put(const char *text, uint8_t length);
/* Bytes lost since the last call: overruns, framing errors, a full buffer. */
uint8_t serial_lost();

/* A number that differs from the last start's. Takes some milliseconds. */
uint16_t boot_number();
/* p power, e reset pin, b brown-out, w watchdog, - not known (a boot loader cleared the flags). */
char reset_cause();

void watchdog_begin();
void watchdog_feed();
/* Sleeps until an interrupt, at most a millisecond; returns at once if one left something to do. */
void rest();

#endif
