/* What the ATmega328P does by hardware: pulses out, pulses in, serial line, watchdog. ../README.md has the pins. */
#ifndef ROVER_BOARD_H
#define ROVER_BOARD_H

#include "vehicle.h"

/* The car in the EEPROM; nine zeros if there is none, or it is damaged. Call it once. */
const struct car *car_kept();
/* Writes a car into the EEPROM, if it is another than there, at most a byte each time and without waiting. Call it again
 * and again, but not while the car drives. */
void car_keep(const struct car *car);

/* A car's neutral pulses on both pins; of nine zeros none. The first thing that setup() does. */
void pulses_begin(const struct car *car);
/* Sets what the pins do from their next pulse on. Another car's pulses begin once no pulse is on. If a pulse is one that
 * none of the car's servos should see, both become neutral. Call it every 2 ms. */
void pulses_set(const struct car *car, uint16_t steering_us, uint16_t throttle_us);

/* The receiver's pulses, and the clock. */
void receiver_begin();
/* Milliseconds since receiver_begin(); wraps at 32 bits. It replaces millis(), because the core's Timer0 is off. Call it
 * at least every half hour. */
uint32_t clock_ms();
/* Returns whether a whole pulse came on the channel since the last call, and if so, its length and its period. */
bool receiver_take(enum channel channel, uint16_t *pulse_us, uint16_t *period_us);

void serial_begin();
/* The next byte of the host, or -1. */
int serial_take();
/* Queues the whole line, or nothing if there is no room for it. */
bool serial_put(const char *text, uint8_t length);
/* Bytes lost since the last call: overruns, framing errors, a full buffer. */
uint8_t serial_lost();

/* A number that differs from that of the start before. Takes some milliseconds. */
uint16_t boot_number();
/* p power, e reset pin, b brown-out, w watchdog, - not known (a boot loader cleared the flags). */
char reset_cause();

void watchdog_begin();
void watchdog_feed();
/* Sleeps until an interrupt, at most about a millisecond; returns at once if an interrupt left something to do. */
void rest();

#endif
