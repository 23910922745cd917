#include "vehicle.h"

#include <string.h>

const struct car DEFAULT_CAR = {
    {{STEERING_PERIOD_US, STEERING_MIN_US, STEERING_NEUTRAL_US, STEERING_MAX_US},
     {THROTTLE_PERIOD_US, THROTTLE_MIN_US, THROTTLE_NEUTRAL_US, THROTTLE_MAX_US}},
    CAP_MAX_US,
};
_Static_assert(sizeof(struct car) == CAR_NUMBERS * sizeof(uint16_t), "a car is its numbers");

void count(uint16_t *counter) {
    if (*counter < UINT16_MAX) (*counter)++;
}

static bool within(uint32_t value, uint32_t low, uint32_t high) { return low <= value && value <= high; }

static uint16_t distance(uint16_t a, uint16_t b) { return a > b ? a - b : b - a; }

static uint16_t towards(uint16_t from_us, uint16_t to_us, uint32_t step_us) {
    if (distance(from_us, to_us) <= step_us) return to_us;
    return (uint16_t)(to_us > from_us ? from_us + step_us : from_us - step_us);
}

uint32_t car_id(const struct car *car) { return crc32((const char *)car, sizeof *car); }

bool throttle_is_fast(const struct car *car) { return car->servos[THROTTLE].period_us < PERIOD_MIN_US; }

static bool slow_allowed(const struct servo *servo, uint16_t neutral_min_us) {
    return within(servo->period_us, PERIOD_MIN_US, PERIOD_MAX_US) &&
           within(servo->neutral_us, neutral_min_us, NEUTRAL_MAX_US) &&
           within(servo->min_us, PULSE_MIN_US, servo->neutral_us) && within(servo->max_us, servo->neutral_us, PULSE_MAX_US);
}

bool car_allowed(const struct car *car) {
    const struct servo *steering = &car->servos[STEERING], *throttle = &car->servos[THROTTLE];
    if (!slow_allowed(steering, STEERING_NEUTRAL_MIN_US) ||
        steering->neutral_us - steering->min_us < STEERING_THROW_US ||
        steering->max_us - steering->neutral_us < STEERING_THROW_US)
        return false;
    if (!within(car->cap_us, 1, CAP_MAX_US)) return false;
    if (!throttle_is_fast(car)) return slow_allowed(throttle, THROTTLE_NEUTRAL_MIN_US);
    return within(throttle->period_us, FAST_PERIOD_MIN_US, FAST_PERIOD_MAX_US) &&
           within(throttle->neutral_us, FAST_NEUTRAL_MIN_US, FAST_NEUTRAL_MAX_US) &&
           throttle->min_us == throttle->neutral_us && within(throttle->max_us, throttle->neutral_us, THROTTLE_MAX_US);
}

static uint16_t neutral_us(const struct vehicle *vehicle, enum channel channel) {
    return vehicle->car.servos[channel].neutral_us;
}

/* Whether the throttle's pulses come as densely as to be misread now and then; a gamepad's lines do not. */
static bool throttle_may_err(const struct vehicle *vehicle) {
#ifdef HUMAN_GAMEPAD
    (void)vehicle;
    return false;
#else
    return throttle_is_fast(&vehicle->car);
#endif
}

/* How many pulses make a signal. */
static uint8_t signal_pulses(const struct vehicle *vehicle, enum channel channel) {
    return channel == THROTTLE && throttle_may_err(vehicle) ? FAST_SIGNAL_PULSES : SIGNAL_PULSES;
}

static void enter(struct vehicle *vehicle, enum state state, enum reason reason) {
    vehicle->state = (char)state;
    vehicle->reason = (char)reason;
    vehicle->wanted_us[STEERING] = vehicle->steering_us = neutral_us(vehicle, STEERING);
    vehicle->wanted_us[THROTTLE] = vehicle->throttle_us = neutral_us(vehicle, THROTTLE);
    vehicle->wary = false;
    vehicle->throttle_moved = 0;
    vehicle->throttle_free = false;
}

void vehicle_start(struct vehicle *vehicle, uint16_t boot, const struct car *car) {
    *vehicle = (struct vehicle){0};
    vehicle->boot = boot;
    vehicle->result = NONE_YET;
    vehicle->car = *car;
    vehicle->car_id = car_id(car);
    vehicle->car_told = vehicle->car_id == car_id(&DEFAULT_CAR);
    vehicle->cap_us = car->cap_us;
    vehicle->lowered_us = UINT16_MAX;
    vehicle->throttle_off_rest = 0xFF;
    enter(vehicle, MANUAL, AFTER_RESET);
}

static void forget_wiggle(struct vehicle *vehicle) {
    for (uint8_t i = 0; i < 3; i++) vehicle->wiggle[i].seen = false;
}

static void forget_signal(struct vehicle *vehicle, struct received *received) {
    received->present = false;
    received->seen = 0;
    vehicle->throttle_free = false;
    vehicle->throttle_off_rest = 0xFF;
    forget_wiggle(vehicle);
}

/* A signal that returns after a loss may come from a receiver that makes up pulses while its transmitter is off. */
static void judge_signal(struct vehicle *vehicle, uint32_t now_ms) {
    for (uint8_t channel = STEERING; channel <= THROTTLE; channel++) {
        struct received *received = &vehicle->received[channel];
        if (!received->present || now_ms - received->at_ms[received->oldest] <= SIGNAL_TIMEOUT_MS) continue;
        forget_signal(vehicle, received);
    }
}

static bool has_signal(const struct vehicle *vehicle) {
    return vehicle->received[STEERING].present && vehicle->received[THROTTLE].present;
}

static bool human_gives_throttle(const struct vehicle *vehicle) {
    return vehicle->state == MANUAL && vehicle->throttle_free && vehicle->throttle_off_rest;
}

/* What the pins get of the human's throttle. A gamepad's comes from the host too, and gets no more than that does. */
static uint16_t passed_us(const struct vehicle *vehicle) {
    uint16_t pulse_us = vehicle->received[THROTTLE].pulse_us;
#ifdef HUMAN_GAMEPAD
    const struct servo *servo = &vehicle->car.servos[THROTTLE];
    pulse_us = towards(servo->neutral_us, pulse_us, vehicle->cap_us);
    if (pulse_us < servo->min_us) return servo->min_us;
    if (pulse_us > servo->max_us) return servo->max_us;
#endif
    return pulse_us;
}

/* Notes a steering pulse. Returns whether the stick has moved from where it was on arming, as see_throttle() does. */
static bool see_steering(struct vehicle *vehicle, uint16_t pulse_us, uint32_t now_ms) {
    struct moment now = {true, now_ms}, *wiggle = vehicle->wiggle;
    if (distance(pulse_us, neutral_us(vehicle, STEERING)) >= WIGGLE_US) {
        wiggle[pulse_us > neutral_us(vehicle, STEERING)] = now;
        if (wiggle[0].seen && wiggle[1].seen) wiggle[2] = now;
    }
    if (distance(pulse_us, vehicle->still_us) > STEERING_DEAD_BAND_US / 2) {
        vehicle->still_us = pulse_us;
        vehicle->still_ms = now_ms;
    }
    return distance(pulse_us, vehicle->rest_us[STEERING]) > STEERING_DEAD_BAND_US;
}

static bool see_throttle(struct vehicle *vehicle, uint16_t pulse_us) {
    bool off_rest = distance(pulse_us, neutral_us(vehicle, THROTTLE)) > THROTTLE_DEAD_BAND_US;
    bool moved = distance(pulse_us, vehicle->rest_us[THROTTLE]) > THROTTLE_DEAD_BAND_US;
    vehicle->throttle_off_rest = (uint8_t)(vehicle->throttle_off_rest << 1 | off_rest);
    vehicle->throttle_moved = (uint8_t)(vehicle->throttle_moved << 1 | moved);
    if (vehicle->throttle_off_rest) forget_wiggle(vehicle);
    if (!vehicle->throttle_off_rest && has_signal(vehicle)) vehicle->throttle_free = true;
    uint8_t pulses = 0;
    for (uint8_t bits = vehicle->throttle_moved; bits; bits >>= 1) pulses += bits & 1;
    return pulses >= (throttle_may_err(vehicle) ? FAST_MOVED_PULSES : 1);
}

/* Whether the car's transmitter may send this. */
static bool is_pulse(const struct car *car, enum channel channel, uint32_t pulse_us, uint16_t period_us) {
    uint16_t nominal = car->servos[channel].period_us;
    bool fast = channel == THROTTLE && throttle_is_fast(car);
    return within(pulse_us, fast ? FAST_PULSE_MIN_US : PULSE_MIN_US, fast ? FAST_PULSE_MAX_US : PULSE_MAX_US) &&
           nominal && distance(period_us, nominal) <= nominal / 4;
}

void vehicle_received(struct vehicle *vehicle, enum channel channel, uint16_t pulse_us, uint16_t period_us,
                      uint32_t now_ms) {
    if (!is_pulse(&vehicle->car, channel, pulse_us, period_us)) return;
    judge_signal(vehicle, now_ms); /* before this pulse hides that the signal was lost */
    struct received *received = &vehicle->received[channel];
    uint8_t pulses = signal_pulses(vehicle, channel);
    received->pulse_us = pulse_us;
    received->period_us = period_us;
    received->at_ms[received->oldest] = now_ms;
    received->oldest = (uint8_t)((received->oldest + 1) % pulses);
    if (received->seen < pulses) received->seen++;
    received->present = received->seen == pulses && now_ms - received->at_ms[received->oldest] <= SIGNAL_TIMEOUT_MS;
    bool moved = channel == STEERING ? see_steering(vehicle, pulse_us, now_ms) : see_throttle(vehicle, pulse_us);
    if (moved && vehicle->state != MANUAL) enter(vehicle, MANUAL, HUMAN);
}

/* Whether a command asks for pulses that none may ask for; counts it. */
static bool is_out_of_range(struct vehicle *vehicle, const struct command *command) {
    const struct servo *steering = &vehicle->car.servos[STEERING], *throttle = &vehicle->car.servos[THROTTLE];
    if (!within(command->steering_us, steering->min_us, steering->max_us) ||
        !within(command->throttle_us, throttle->min_us, throttle->max_us)) {
        count(&vehicle->out_of_range);
        return true;
    }
    return false;
}

#ifdef HUMAN_GAMEPAD
/* A gamepad's sticks, as if a receiver had measured them. Each must answer a newer status than the last, and is as old as
 * that status, so that nothing which waits or comes twice counts. Both 0: the human has let go, which counts at once.
 * They are judged as they are; passed_us() limits what the pins get. */
static void take_sticks(struct vehicle *vehicle, const struct command *command, uint32_t now_ms) {
    uint32_t at_ms = command->heard_ms, age_ms = now_ms - at_ms;
    if (vehicle->boot != command->boot || age_ms > SIGNAL_TIMEOUT_MS || age_ms >= now_ms - vehicle->sticks_ms) {
        count(&vehicle->old_commands);
        return;
    }
    bool held = command->steering_us || command->throttle_us;
    const struct servo *steering = &vehicle->car.servos[STEERING], *throttle = &vehicle->car.servos[THROTTLE];
    if (held && (!within(command->steering_us, steering->min_us, steering->max_us) ||
                 !is_pulse(&vehicle->car, THROTTLE, command->throttle_us, throttle->period_us))) {
        count(&vehicle->out_of_range);
        return;
    }
    vehicle->sticks_ms = at_ms;
    if (held) {
        vehicle_received(vehicle, STEERING, (uint16_t)command->steering_us, steering->period_us, at_ms);
        vehicle_received(vehicle, THROTTLE, (uint16_t)command->throttle_us, throttle->period_us, at_ms);
    } else {
        for (uint8_t channel = STEERING; channel <= THROTTLE; channel++) forget_signal(vehicle, &vehicle->received[channel]);
    }
    vehicle_tick(vehicle, now_ms);
}
#endif

enum missing vehicle_missing(const struct vehicle *vehicle, uint32_t now_ms) {
    if (!has_signal(vehicle)) return SIGNAL;
    if (vehicle->throttle_off_rest) return THROTTLE_AT_REST;
    bool let_go = distance(vehicle->still_us, neutral_us(vehicle, STEERING)) <= LET_GO_US &&
                  now_ms - vehicle->still_ms >= LET_GO_MS;
    return vehicle->wiggle[2].seen && let_go ? NOTHING : WIGGLE;
}

static char arm(struct vehicle *vehicle, const struct command *command, uint32_t now_ms) {
    if (vehicle->state == AUTONOMOUS) return DONE; /* the host repeats itself, which renews nothing */
    if (now_ms - command->asked_ms > REQUEST_MS) return EXPIRED;
    if (!vehicle->car_told || command->car != vehicle->car_id) return OTHER_CAR;
    enum missing missing = vehicle_missing(vehicle, now_ms);
    if (missing != NOTHING) return (char)missing;
    vehicle->rest_us[STEERING] = vehicle->received[STEERING].pulse_us;
    vehicle->rest_us[THROTTLE] = vehicle->received[THROTTLE].pulse_us;
    forget_wiggle(vehicle);
    vehicle->commanded_ms = vehicle->driven_ms = vehicle->slewed_ms = now_ms;
    enter(vehicle, AUTONOMOUS, ARMED);
    return DONE;
}

/* in_turn: the command directly follows the last one, so that none was lost between them. */
static enum result drive(struct vehicle *vehicle, const struct command *command, bool in_turn, uint32_t now_ms) {
    const struct servo *throttle = &vehicle->car.servos[THROTTLE];
    if (is_out_of_range(vehicle, command)) return OUT_OF_RANGE;
    if (vehicle->state != AUTONOMOUS) return IGNORED;
    vehicle->wanted_us[STEERING] = (uint16_t)command->steering_us;
    vehicle->wanted_us[THROTTLE] = towards(throttle->neutral_us, (uint16_t)command->throttle_us, vehicle->cap_us);
    /* A drive is as old as the newest status its host has heard: from then it holds for FRESH_MS and the timeout. */
    bool fresh = now_ms - command->heard_ms <= FRESH_MS;
    vehicle->commanded_ms = fresh ? now_ms : command->heard_ms + FRESH_MS;
    if (in_turn && now_ms - vehicle->driven_ms > PAUSE_MS) {
        vehicle->wary = true;
        vehicle->paused_ms = now_ms;
    }
    vehicle->driven_ms = now_ms;
    return DONE;
}

static enum result lower_cap(struct vehicle *vehicle, uint32_t throttle_us) {
    const struct servo *throttle = &vehicle->car.servos[THROTTLE];
    if (!within(throttle_us, throttle->min_us, throttle->max_us)) {
        count(&vehicle->out_of_range);
        return OUT_OF_RANGE;
    }
    if (vehicle->state == AUTONOMOUS) return IGNORED;
    uint16_t cap_us = distance((uint16_t)throttle_us, throttle->neutral_us);
    if (cap_us < vehicle->cap_us) vehicle->cap_us = vehicle->lowered_us = cap_us;
    return DONE;
}

/* With another car, the gesture counts no more, and signals count that are this car's too: who drives by hand goes on. */
static char take_car(struct vehicle *vehicle, const uint16_t *numbers) {
    struct car car;
    memcpy(&car, numbers, sizeof car);
    if (!car_allowed(&car)) {
        count(&vehicle->out_of_range);
        return OUT_OF_RANGE;
    }
    if (vehicle->state == AUTONOMOUS) return IGNORED;
    uint32_t id = car_id(&car);
    bool same = id == vehicle->car_id;
    if (!same && human_gives_throttle(vehicle)) return THROTTLE_AT_REST;
    vehicle->car_told = true;
    if (same) return DONE;
    vehicle->car = car;
    vehicle->car_id = id;
    vehicle->cap_us = car.cap_us < vehicle->lowered_us ? car.cap_us : vehicle->lowered_us;
    for (uint8_t channel = STEERING; channel <= THROTTLE; channel++) {
        struct received *received = &vehicle->received[channel];
        if (is_pulse(&car, (enum channel)channel, received->pulse_us, received->period_us)) continue;
        *received = (struct received){0};
        forget_signal(vehicle, received);
    }
    forget_wiggle(vehicle);
    if (distance(vehicle->received[THROTTLE].pulse_us, neutral_us(vehicle, THROTTLE)) > THROTTLE_DEAD_BAND_US) {
        vehicle->throttle_free = false;
        vehicle->throttle_off_rest = 0xFF;
    }
    return DONE;
}

static enum result neutral(struct vehicle *vehicle) {
    if (vehicle->state != AUTONOMOUS) return IGNORED; /* in manual the car is the human's */
    enter(vehicle, STOPPED, HOST_NEUTRAL);
    return DONE;
}

void vehicle_command(struct vehicle *vehicle, const struct command *command, uint32_t now_ms) {
    /* First, so that a command that comes now cannot save one that timed out. */
    vehicle_tick(vehicle, now_ms);
#ifdef HUMAN_GAMEPAD
    if (command->kind == COMMAND_STICKS) {
        take_sticks(vehicle, command, now_ms);
        return;
    }
#endif
    uint32_t ahead = command->sequence - vehicle->sequence;
    bool in_turn = ahead == 1;
    bool old = command->boot != vehicle->boot || !within(ahead, 1, SEQUENCE_WINDOW);
    bool dated = command->kind == COMMAND_ARM || command->kind == COMMAND_DRIVE;
    if (old || (dated && now_ms - command->heard_ms > LATE_MS)) {
        count(&vehicle->old_commands);
        vehicle->result = old ? OLD : LATE;
        return;
    }
    vehicle->sequence = command->sequence;
    switch (command->kind) {
        case COMMAND_ARM:
            vehicle->result = arm(vehicle, command, now_ms);
            break;
        case COMMAND_DRIVE:
            vehicle->result = (char)drive(vehicle, command, in_turn, now_ms);
            break;
        case COMMAND_LOWER:
            vehicle->result = (char)lower_cap(vehicle, command->throttle_us);
            break;
        case COMMAND_CAR:
            vehicle->result = take_car(vehicle, command->numbers);
            break;
        default:
            vehicle->result = (char)neutral(vehicle);
    }
}

void vehicle_tick(struct vehicle *vehicle, uint32_t now_ms) {
    judge_signal(vehicle, now_ms);
    for (uint8_t i = 0; i < 3; i++)
        if (now_ms - vehicle->wiggle[i].at_ms > (i == 2 ? WIGGLE_LIFETIME_MS : WIGGLE_MS)) vehicle->wiggle[i].seen = false;
    if (vehicle->state == AUTONOMOUS) {
        if (!has_signal(vehicle))
            enter(vehicle, STOPPED, NO_SIGNAL);
        else if (now_ms - vehicle->commanded_ms >= COMMAND_TIMEOUT_MS)
            enter(vehicle, STOPPED, TIMEOUT);
        else if (vehicle->wary && now_ms - vehicle->driven_ms >= WARY_TIMEOUT_MS)
            enter(vehicle, STOPPED, PAUSES);
        else if (now_ms - vehicle->paused_ms > WARY_MS)
            vehicle->wary = false;
    }
    if (vehicle->state == AUTONOMOUS) {
        /* No servo and no car should have to move faster than this. */
        uint32_t ms = now_ms - vehicle->slewed_ms;
        vehicle->slewed_ms = now_ms;
        uint16_t *wanted_us = vehicle->wanted_us;
        vehicle->steering_us = towards(vehicle->steering_us, wanted_us[STEERING], ms * STEERING_SLEW_US_PER_MS);
        vehicle->throttle_us = towards(vehicle->throttle_us, wanted_us[THROTTLE], ms * THROTTLE_SLEW_US_PER_MS);
    } else if (vehicle->state == MANUAL && has_signal(vehicle)) {
        vehicle->steering_us = vehicle->received[STEERING].pulse_us;
        vehicle->throttle_us = vehicle->throttle_free ? passed_us(vehicle) : neutral_us(vehicle, THROTTLE);
    } else {
        vehicle->steering_us = neutral_us(vehicle, STEERING);
        vehicle->throttle_us = neutral_us(vehicle, THROTTLE);
    }
}

static void put_char(struct line *line, char c) {
    line_char(line, ' ');
    line_char(line, c);
}

bool vehicle_may_keep(const struct vehicle *vehicle) {
    return vehicle->car_told && vehicle->state != AUTONOMOUS && !human_gives_throttle(vehicle);
}

uint8_t vehicle_hello(const struct vehicle *vehicle, char reset_cause, struct line *line) {
    line_begin(line, 'H');
    line_number(line, PROTOCOL_VERSION);
    line_text(line, FIRMWARE_VERSION);
    line_number(line, vehicle->boot);
    line_number(line, vehicle->sequence);
    put_char(line, reset_cause);
    line_number(line, vehicle->car_id);
    return line_end(line);
}

uint8_t vehicle_status(const struct vehicle *vehicle, uint32_t now_ms, struct line *line) {
    line_begin(line, 'S');
    line_number(line, vehicle->boot);
    line_number(line, now_ms);
    line_number(line, vehicle->sequence);
    put_char(line, vehicle->result);
    put_char(line, vehicle->state);
    put_char(line, vehicle->reason);
    put_char(line, (char)vehicle_missing(vehicle, now_ms));
    line_number(line, vehicle->steering_us);
    line_number(line, vehicle->throttle_us);
    line_number(line, neutral_us(vehicle, THROTTLE) + vehicle->cap_us);
    for (uint8_t channel = STEERING; channel <= THROTTLE; channel++) {
        const struct received *received = &vehicle->received[channel];
        if (received->present) {
            line_number(line, channel == THROTTLE ? passed_us(vehicle) : received->pulse_us);
            line_number(line, received->period_us);
        } else {
            line_text(line, "-");
            line_text(line, "-");
        }
    }
    line_number(line, vehicle->bad_lines);
    line_number(line, vehicle->old_commands);
    line_number(line, vehicle->out_of_range);
    line_number(line, vehicle->lost_bytes);
    return line_end(line);
}
