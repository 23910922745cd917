#include "vehicle.h"

void count(uint16_t *counter) {
    if (*counter < UINT16_MAX) (*counter)++;
}

static bool within(uint32_t value, uint32_t low, uint32_t high) { return low <= value && value <= high; }

static uint16_t distance(uint16_t a, uint16_t b) { return a > b ? a - b : b - a; }

static void enter(struct vehicle *vehicle, enum state state, enum reason reason) {
    vehicle->state = (char)state;
    vehicle->reason = (char)reason;
    vehicle->wanted_us[STEERING] = STEERING_NEUTRAL_US;
    vehicle->wanted_us[THROTTLE] = THROTTLE_NEUTRAL_US;
    vehicle->steering_us = STEERING_NEUTRAL_US;
    vehicle->throttle_us = THROTTLE_NEUTRAL_US;
    vehicle->wary = false;
    vehicle->throttle_moved = 0;
    vehicle->throttle_free = false;
}

void vehicle_start(struct vehicle *vehicle, uint16_t boot) {
    *vehicle = (struct vehicle){0};
    vehicle->boot = boot;
    vehicle->result = NONE_YET;
    vehicle->cap_us = THROTTLE_CAP_US;
    vehicle->throttle_off_rest = 0xFF;
    enter(vehicle, MANUAL, AFTER_RESET);
}

/* Who comes back after a loss may be a receiver that makes up pulses, its transmitter switched off. */
static void judge_signal(struct vehicle *vehicle, uint32_t now_ms) {
    for (uint8_t channel = STEERING; channel <= THROTTLE; channel++) {
        struct received *received = &vehicle->received[channel];
        if (!received->present || now_ms - received->at_ms[received->oldest] <= SIGNAL_TIMEOUT_MS) continue;
        received->present = false;
        received->seen = 0;
        vehicle->throttle_free = false;
        vehicle->throttle_off_rest = 0xFF;
        vehicle->sides[0].seen = vehicle->sides[1].seen = false;
    }
}

static bool has_signal(const struct vehicle *vehicle) {
    return vehicle->received[STEERING].present && vehicle->received[THROTTLE].present;
}

/* Whether a stick has moved from where it was on arming. */
static bool see_steering(struct vehicle *vehicle, uint16_t pulse_us, uint32_t now_ms) {
    if (pulse_us <= STEERING_NEUTRAL_US - WIGGLE_US) vehicle->sides[0] = (struct side){true, now_ms};
    if (pulse_us >= STEERING_NEUTRAL_US + WIGGLE_US) vehicle->sides[1] = (struct side){true, now_ms};
    if (distance(pulse_us, vehicle->still_us) > STEERING_DEAD_BAND_US / 2) {
        vehicle->still_us = pulse_us;
        vehicle->still_ms = now_ms;
    }
    return distance(pulse_us, vehicle->rest_us[STEERING]) > STEERING_DEAD_BAND_US;
}

static bool see_throttle(struct vehicle *vehicle, uint16_t pulse_us) {
    bool off_rest = distance(pulse_us, THROTTLE_NEUTRAL_US) > THROTTLE_DEAD_BAND_US;
    bool moved = distance(pulse_us, vehicle->rest_us[THROTTLE]) > THROTTLE_DEAD_BAND_US;
    vehicle->throttle_off_rest = (uint8_t)(vehicle->throttle_off_rest << 1 | off_rest);
    vehicle->throttle_moved = (uint8_t)(vehicle->throttle_moved << 1 | moved);
    if (!vehicle->throttle_off_rest && has_signal(vehicle)) vehicle->throttle_free = true;
    uint8_t pulses = 0;
    for (uint8_t bits = vehicle->throttle_moved; bits; bits >>= 1) pulses += bits & 1;
    return pulses >= THROTTLE_MOVED_PULSES;
}

void vehicle_received(struct vehicle *vehicle, enum channel channel, uint16_t pulse_us, uint16_t period_us,
                      uint32_t now_ms) {
    uint16_t nominal = channel == STEERING ? RECEIVER_STEERING_PERIOD_US : RECEIVER_THROTTLE_PERIOD_US;
    if (channel == STEERING ? !within(pulse_us, RECEIVER_STEERING_MIN_US, RECEIVER_STEERING_MAX_US)
                            : !within(pulse_us, RECEIVER_THROTTLE_MIN_US, RECEIVER_THROTTLE_MAX_US))
        return;
    if (distance(period_us, nominal) > nominal / 4) return;
    judge_signal(vehicle, now_ms); /* before this pulse makes it good again */
    struct received *received = &vehicle->received[channel];
    uint8_t pulses = channel == STEERING ? STEERING_SIGNAL_PULSES : THROTTLE_SIGNAL_PULSES;
    received->pulse_us = pulse_us;
    received->period_us = period_us;
    received->at_ms[received->oldest] = now_ms;
    received->oldest = (uint8_t)((received->oldest + 1) % pulses);
    if (received->seen < pulses) received->seen++;
    received->present = received->seen == pulses && now_ms - received->at_ms[received->oldest] <= SIGNAL_TIMEOUT_MS;
    bool moved = channel == STEERING ? see_steering(vehicle, pulse_us, now_ms) : see_throttle(vehicle, pulse_us);
    if (moved && vehicle->state != MANUAL) enter(vehicle, MANUAL, HUMAN);
}

enum missing vehicle_missing(const struct vehicle *vehicle, uint32_t now_ms) {
    if (!has_signal(vehicle)) return SIGNAL;
    if (vehicle->throttle_off_rest) return THROTTLE_AT_REST;
    bool wiggled = vehicle->sides[0].seen && vehicle->sides[1].seen && now_ms - vehicle->still_ms >= LET_GO_MS;
    return wiggled ? NOTHING : WIGGLE;
}

static char arm(struct vehicle *vehicle, uint32_t now_ms) {
    if (vehicle->state == AUTONOMOUS) return DONE; /* the host repeats itself: renews nothing */
    enum missing missing = vehicle_missing(vehicle, now_ms);
    if (missing != NOTHING) return (char)missing;
    vehicle->rest_us[STEERING] = vehicle->received[STEERING].pulse_us;
    vehicle->rest_us[THROTTLE] = vehicle->received[THROTTLE].pulse_us;
    vehicle->sides[0].seen = vehicle->sides[1].seen = false;
    vehicle->commanded_ms = vehicle->driven_ms = vehicle->slewed_ms = now_ms;
    enter(vehicle, AUTONOMOUS, ARMED);
    return DONE;
}

/* in_turn: it is the next after the last one, so that none was lost between them. */
static enum result drive(struct vehicle *vehicle, const struct command *command, bool in_turn, uint32_t now_ms) {
    if (!within(command->steering_us, STEERING_MIN_US, STEERING_MAX_US) ||
        !within(command->throttle_us, THROTTLE_MIN_US, THROTTLE_MAX_US)) {
        count(&vehicle->out_of_range);
        return OUT_OF_RANGE;
    }
    if (vehicle->state != AUTONOMOUS) return IGNORED;
    vehicle->wanted_us[STEERING] = (uint16_t)command->steering_us;
    bool capped = command->throttle_us > vehicle->cap_us;
    vehicle->wanted_us[THROTTLE] = capped ? vehicle->cap_us : (uint16_t)command->throttle_us;
    /* What it is asked by is as old as what its host has heard: from then on it holds for FRESH_MS and the timeout. */
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
    if (!within(throttle_us, THROTTLE_MIN_US, THROTTLE_MAX_US)) {
        count(&vehicle->out_of_range);
        return OUT_OF_RANGE;
    }
    if (vehicle->state == AUTONOMOUS) return IGNORED;
    if (throttle_us < vehicle->cap_us) vehicle->cap_us = (uint16_t)throttle_us;
    return DONE;
}

static enum result neutral(struct vehicle *vehicle) {
    if (vehicle->state != AUTONOMOUS) return IGNORED; /* in manual the car is the human's */
    enter(vehicle, STOPPED, HOST_NEUTRAL);
    return DONE;
}

void vehicle_command(struct vehicle *vehicle, const struct command *command, uint32_t now_ms) {
    /* What came too late must not be saved by what comes now. */
    vehicle_tick(vehicle, now_ms);
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
            vehicle->result = arm(vehicle, now_ms);
            break;
        case COMMAND_DRIVE:
            vehicle->result = (char)drive(vehicle, command, in_turn, now_ms);
            break;
        case COMMAND_LOWER:
            vehicle->result = (char)lower_cap(vehicle, command->throttle_us);
            break;
        default:
            vehicle->result = (char)neutral(vehicle);
    }
}

/* No servo, and no car, should be asked for more at once. */
static uint16_t towards(uint16_t from_us, uint16_t to_us, uint32_t step_us) {
    if (distance(from_us, to_us) <= step_us) return to_us;
    return (uint16_t)(to_us > from_us ? from_us + step_us : from_us - step_us);
}

void vehicle_tick(struct vehicle *vehicle, uint32_t now_ms) {
    judge_signal(vehicle, now_ms);
    for (struct side *side = vehicle->sides; side < vehicle->sides + 2; side++)
        if (now_ms - side->at_ms > WIGGLE_LIFETIME_MS) side->seen = false;
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
        uint32_t ms = now_ms - vehicle->slewed_ms;
        vehicle->slewed_ms = now_ms;
        uint16_t *wanted_us = vehicle->wanted_us;
        vehicle->steering_us = towards(vehicle->steering_us, wanted_us[STEERING], ms * STEERING_SLEW_US_PER_MS);
        vehicle->throttle_us = towards(vehicle->throttle_us, wanted_us[THROTTLE], ms * THROTTLE_SLEW_US_PER_MS);
    } else if (vehicle->state == MANUAL && has_signal(vehicle)) {
        vehicle->steering_us = vehicle->received[STEERING].pulse_us;
        vehicle->throttle_us = vehicle->throttle_free ? vehicle->received[THROTTLE].pulse_us : THROTTLE_NEUTRAL_US;
    } else {
        vehicle->steering_us = STEERING_NEUTRAL_US;
        vehicle->throttle_us = THROTTLE_NEUTRAL_US;
    }
}

static void put_char(struct line *line, char c) {
    line_char(line, ' ');
    line_char(line, c);
}

uint8_t vehicle_hello(const struct vehicle *vehicle, char reset_cause, struct line *line) {
    line_begin(line, 'H');
    line_number(line, PROTOCOL_VERSION);
    line_text(line, FIRMWARE_VERSION);
    line_number(line, vehicle->boot);
    line_number(line, vehicle->sequence);
    put_char(line, reset_cause);
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
    line_number(line, vehicle->cap_us);
    for (uint8_t channel = STEERING; channel <= THROTTLE; channel++) {
        const struct received *received = &vehicle->received[channel];
        if (received->present) {
            line_number(line, received->pulse_us);
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
