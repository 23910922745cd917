/* Who drives: the state machine between the host's commands, the transmitter's pulses and the pins. Plain C, no Arduino.
 * Times are milliseconds of a clock that wraps at 32 bits; pulses are microseconds. */
#ifndef ROVER_VEHICLE_H
#define ROVER_VEHICLE_H

#include "protocol.h"

#ifdef __cplusplus
extern "C" {
#endif

enum {
    /* The car of the recordings: actions -1 to 1 and 0 to 1 of rover_lib/onboard/car/pwm.py. */
    STEERING_PERIOD_US = 21316,
    STEERING_MIN_US = 900,
    STEERING_NEUTRAL_US = 1456,
    STEERING_MAX_US = 2012,
    THROTTLE_PERIOD_US = 1016,
    THROTTLE_MIN_US = 120,
    THROTTLE_NEUTRAL_US = 120, /* stopped */
    THROTTLE_MAX_US = 711,
    /* The most that a host gets, however much it asks for; ../README.md has the recordings' figures behind these. */
    CAP_MAX_US = 118,          /* of throttle, from neutral, either way: action 0.2 of this car. No car's may be more */
    STEERING_SLEW_US_PER_MS = 4,
    THROTTLE_SLEW_US_PER_MS = 2,
    /* The limits of another car; rover_lib/onboard/car/car.py has the same. */
    PERIOD_MIN_US = 3000,
    PERIOD_MAX_US = 25000,
    STEERING_NEUTRAL_MIN_US = 1300,
    THROTTLE_NEUTRAL_MIN_US = 900, /* a speed controller without reverse may stop at 1000 */
    NEUTRAL_MAX_US = 1700,
    STEERING_THROW_US = 250,   /* at least this from neutral to either end, so that the wiggle is possible */
    FAST_PERIOD_MIN_US = 1000, /* a throttle like this car's, forward only */
    FAST_PERIOD_MAX_US = 1020,
    FAST_NEUTRAL_MIN_US = 80,
    FAST_NEUTRAL_MAX_US = 160,
    /* What counts as a pulse of the transmitter: recordings have steering of 1008 to 1948 us and throttle up to 948 us.
     * The period may be off by a quarter. */
    PULSE_MIN_US = 800,
    PULSE_MAX_US = 2200,
    FAST_PULSE_MIN_US = 40,
    FAST_PULSE_MAX_US = 980,
    /* A stick that moved this far from where it was on arming is the human's. The recordings' resting sticks stay
     * within 16 us. */
    STEERING_DEAD_BAND_US = 48,
    THROTTLE_DEAD_BAND_US = 32,
    FAST_MOVED_PULSES = 5,     /* of the last eight, so that single ones may be misread; of a slow signal one is enough */
    /* A signal is present while its last two pulses (a fast throttle's last eight) are all younger than this. */
#ifdef HUMAN_GAMEPAD
    SIGNAL_TIMEOUT_MS = 150, /* as a host's command: its pulses come through a host */
#else
    SIGNAL_TIMEOUT_MS = 100,
#endif
    SIGNAL_PULSES = 2,
    FAST_SIGNAL_PULSES = 8,
    /* The gesture, a wiggle of the steering stick: at least this far to both sides of neutral within WIGGLE_MS, then still
     * near neutral for LET_GO_MS, and the throttle at rest all the while: nobody drives like that. */
    WIGGLE_US = 200,
    WIGGLE_MS = 3000,
    WIGGLE_LIFETIME_MS = 30000,
    LET_GO_US = 100,           /* a trim's */
    LET_GO_MS = 1000,
    REQUEST_MS = 31000,        /* an arming that was asked for longer ago is refused; the hosts' own limits are shorter */
    COMMAND_TIMEOUT_MS = 150,
    LATE_MS = 150,             /* a drive or arm is late if its host has not heard from us for longer than this */
    FRESH_MS = 50,             /* a drive holds in full if its host has heard from us within this, otherwise for less */
    /* A host that pauses for longer than PAUSE_MS and then drives on has no time for the car. During the next WARY_MS a
     * pause of WARY_TIMEOUT_MS stops it; that leaves 12 ms to spare at 30 commands a second. */
    PAUSE_MS = 100,
    WARY_MS = 500,
    WARY_TIMEOUT_MS = 45,
    SEQUENCE_WINDOW = 65535    /* a sequence number must be ahead of the last by 1 to this, modulo 2^32 */
};

enum channel { STEERING, THROTTLE };
enum state { MANUAL = 'M', AUTONOMOUS = 'A', STOPPED = 'S' };
/* A car's pulses in microseconds. Its CRC-32, as these 18 bytes lie in memory here and in the chip, is its name. */
struct servo {
    uint16_t period_us, min_us, neutral_us, max_us;
};
struct car {
    struct servo servos[2]; /* steering, throttle */
    uint16_t cap_us;        /* of throttle, from neutral, either way */
};
extern const struct car DEFAULT_CAR;

/* Why the state is what it is. */
enum reason { AFTER_RESET = 'r', HUMAN = 'h', ARMED = 'a', TIMEOUT = 't', PAUSES = 'p', NO_SIGNAL = 's',
              HOST_NEUTRAL = 'n' };
/* What became of the last command. */
enum result {
    NONE_YET = '-',
    DONE = 'k',
    IGNORED = 'i',         /* a drive or neutral while not autonomous; a lower cap or a car while autonomous */
    OUT_OF_RANGE = 'r',    /* or a car that is not allowed */
    OTHER_CAR = 'c',       /* an arming for another car than the one that was told since the reset */
    OLD = 'o',             /* its sequence number is not a new one, or it is for another boot */
    LATE = 'l',            /* it waited in the link for longer than LATE_MS */
    EXPIRED = 'e'          /* an arming that somebody asked for longer ago than REQUEST_MS */
};
/* What arming lacks; also the result of an arming that was refused. */
enum missing { NOTHING = '-', SIGNAL = 's', THROTTLE_AT_REST = 't', WIGGLE = 'w' };

struct received {
    uint16_t pulse_us, period_us;            /* of the newest */
    uint32_t at_ms[FAST_SIGNAL_PULSES];      /* when the last two or eight came, in a ring */
    uint8_t oldest, seen;                    /* seen: how many of those came since the signal was lost */
    bool present;
};

struct moment {
    bool seen; /* not too long ago; arming, throttle and a lost signal forget it */
    uint32_t at_ms;
};

struct vehicle {
    char state, reason, result;
    struct car car;
    uint32_t car_id;
    bool car_told;                      /* since the reset; also true of the default, which nobody needs to tell */
    uint16_t boot;                      /* tells this start of the firmware from others */
    uint32_t sequence;                  /* of the last command that was accepted as new */
    uint16_t steering_us, throttle_us;  /* for the pins, always safe; 0: no pulse, as no car is known */
    struct received received[2];
    struct moment wiggle[3];            /* the stick on either side, and both within WIGGLE_MS */
    uint16_t still_us;                  /* the steering stick has stayed near this */
    uint32_t still_ms;                  /* since this time */
    uint8_t throttle_off_rest;          /* the last eight pulses, a bit each: not at rest */
    bool throttle_free;                 /* the human's throttle passes: it was seen at rest */
    uint16_t rest_us[2];                /* the sticks when the host armed */
    uint8_t throttle_moved;             /* the last eight pulses, a bit each: not where it was then */
    uint16_t cap_us;                    /* from neutral, either way: the car's, or lowered_us if that is less */
    uint16_t lowered_us;                /* what the host lowered it to since the reset; another car does not raise it */
    uint16_t wanted_us[2];              /* of the last valid drive since arming */
    uint32_t commanded_ms, slewed_ms;
    uint32_t driven_ms;                 /* when the last valid drive came, or the arming if none has */
    uint32_t paused_ms;                 /* while wary: when the drive came that ended the pause */
    bool wary;
    uint32_t sticks_ms; /* of the status that a gamepad's last sticks answered */
    uint16_t bad_lines, old_commands, out_of_range, lost_bytes; /* stay at 65535 */
};

/* Whether this firmware may drive the car. */
bool car_allowed(const struct car *car);
uint32_t car_id(const struct car *car);
/* Whether the throttle's signal is a fast one, like the default's. */
bool throttle_is_fast(const struct car *car);
/* car: the one whose neutral the pins have now; nine zeros: none is known, and the pins have no pulse. */
void vehicle_start(struct vehicle *vehicle, uint16_t boot, const struct car *car);
/* A pulse of the transmitter, as measured. Implausible ones are no pulse. */
void vehicle_received(struct vehicle *vehicle, enum channel channel, uint16_t pulse_us, uint16_t period_us,
                      uint32_t now_ms);
/* What arming lacks now, after vehicle_tick. */
enum missing vehicle_missing(const struct vehicle *vehicle, uint32_t now_ms);
/* A command that reader_take returned; not COMMAND_HELLO, which asks nothing of the vehicle. */
void vehicle_command(struct vehicle *vehicle, const struct command *command, uint32_t now_ms);
/* Checks all time limits and sets the pins' pulses. Call it every few milliseconds, after giving it all that is new. */
void vehicle_tick(struct vehicle *vehicle, uint32_t now_ms);
/* Whether now is a time to write the car into the EEPROM: it was told, and does not drive. */
bool vehicle_may_keep(const struct vehicle *vehicle);
void count(uint16_t *counter);

uint8_t vehicle_hello(const struct vehicle *vehicle, char reset_cause, struct line *line);
uint8_t vehicle_status(const struct vehicle *vehicle, uint32_t now_ms, struct line *line);

#ifdef __cplusplus
}
#endif
#endif
