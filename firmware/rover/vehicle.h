/* Who drives: the state machine between the host's commands, the transmitter's pulses and the pins. Plain C, no Arduino.
 * Times are milliseconds of a clock that wraps at 32 bits; pulses are microseconds. */
#ifndef ROVER_VEHICLE_H
#define ROVER_VEHICLE_H

#include "protocol.h"

#ifdef __cplusplus
extern "C" {
#endif

enum {
    STEERING_NEUTRAL_US = 1456,
    THROTTLE_NEUTRAL_US = 120, /* stopped */
    /* What the host may ask for: actions -1 to 1 and 0 to 1 of rover_lib/onboard/pwm.py. */
    STEERING_MIN_US = 900,
    STEERING_MAX_US = 2012,
    THROTTLE_MIN_US = 120,
    THROTTLE_MAX_US = 711,
    /* What is a pulse of the transmitter: recordings have 1008 to 1948 us and up to 948 us; periods within a quarter. */
    RECEIVER_STEERING_MIN_US = 800,
    RECEIVER_STEERING_MAX_US = 2200,
    RECEIVER_STEERING_PERIOD_US = 21316,
    RECEIVER_THROTTLE_MIN_US = 40,
    RECEIVER_THROTTLE_MAX_US = 980,
    RECEIVER_THROTTLE_PERIOD_US = 1016,
    /* A stick that moved this far from where it was on arming is the human's. The recordings' resting sticks stay
     * within 16 us. */
    STEERING_DEAD_BAND_US = 48,
    THROTTLE_DEAD_BAND_US = 32,
    THROTTLE_MOVED_PULSES = 3, /* in a row: 3 ms; steering has a pulse every 21 ms and one must do, to be quick */
    COMMAND_TIMEOUT_MS = 150,
    SIGNAL_TIMEOUT_MS = 100,   /* four missing steering pulses */
    SEQUENCE_WINDOW = 65535    /* a sequence number may be ahead of the last by 1 to this, modulo 2^32 */
};

enum channel { STEERING, THROTTLE };
enum state { MANUAL = 'M', AUTONOMOUS = 'A', STOPPED = 'S' };
/* Why the state is what it is. */
enum reason { AFTER_RESET = 'r', HUMAN = 'h', ARMED = 'a', TIMEOUT = 't', NO_SIGNAL = 's', HOST_NEUTRAL = 'n' };
/* What became of the last command. */
enum result {
    NONE_YET = '-',
    DONE = 'k',
    IGNORED = 'i',         /* a drive or neutral while not autonomous */
    OUT_OF_RANGE = 'r',
    OLD = 'o',             /* a sequence number that was there already, or another boot's */
    REFUSED_NO_SIGNAL = 's',
    REFUSED_STICK = 't'    /* the throttle stick is not at rest */
};

struct received {
    uint16_t pulse_us, period_us;
    uint32_t at_ms;
    bool present; /* a pulse came within SIGNAL_TIMEOUT_MS */
};

struct vehicle {
    char state, reason, result;
    uint16_t boot;                      /* tells this start of the firmware from others */
    uint32_t sequence;                  /* of the last command that was accepted as new */
    uint16_t steering_us, throttle_us;  /* for the pins, always safe */
    struct received received[2];
    uint16_t rest_us[2];                /* the sticks when the host armed */
    uint8_t throttle_moved;             /* pulses in a row beyond the dead band */
    uint16_t wanted_us[2];              /* of the last valid drive since arming */
    uint32_t commanded_ms;
    uint16_t bad_lines, old_commands, out_of_range, lost_bytes; /* stay at 65535 */
};

void vehicle_start(struct vehicle *vehicle, uint16_t boot);
/* A pulse of the transmitter, as measured. Implausible ones are no pulse. */
void vehicle_received(struct vehicle *vehicle, enum channel channel, uint16_t pulse_us, uint16_t period_us,
                      uint32_t now_ms);
/* A command that reader_take returned; not COMMAND_HELLO, which asks nothing of the vehicle. */
void vehicle_command(struct vehicle *vehicle, const struct command *command, uint32_t now_ms);
/* Call after all that is new was given, at least every few milliseconds: judges the time and sets the pins' pulses. */
void vehicle_tick(struct vehicle *vehicle, uint32_t now_ms);
void count(uint16_t *counter);

uint8_t vehicle_hello(const struct vehicle *vehicle, char reset_cause, struct line *line);
uint8_t vehicle_status(const struct vehicle *vehicle, uint32_t now_ms, struct line *line);

#ifdef __cplusplus
}
#endif
#endif
