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
    vehicle->throttle_moved = 0;
}

void vehicle_start(struct vehicle *vehicle, uint16_t boot) {
    *vehicle = (struct vehicle){0};
    vehicle->boot = boot;
    vehicle->result = NONE_YET;
    vehicle->steering_us = STEERING_NEUTRAL_US;
    vehicle->throttle_us = THROTTLE_NEUTRAL_US;
    enter(vehicle, MANUAL, AFTER_RESET);
}

void vehicle_received(struct vehicle *vehicle, enum channel channel, uint16_t pulse_us, uint16_t period_us,
                      uint32_t now_ms) {
    uint16_t nominal = channel == STEERING ? RECEIVER_STEERING_PERIOD_US : RECEIVER_THROTTLE_PERIOD_US;
    if (channel == STEERING ? !within(pulse_us, RECEIVER_STEERING_MIN_US, RECEIVER_STEERING_MAX_US)
                            : !within(pulse_us, RECEIVER_THROTTLE_MIN_US, RECEIVER_THROTTLE_MAX_US))
        return;
    if (distance(period_us, nominal) > nominal / 4) return;
    vehicle->received[channel] = (struct received){pulse_us, period_us, now_ms, true};
    if (vehicle->state == MANUAL) return;
    bool moved;
    if (channel == STEERING) {
        moved = distance(pulse_us, vehicle->rest_us[STEERING]) > STEERING_DEAD_BAND_US;
    } else {
        bool beyond = distance(pulse_us, vehicle->rest_us[THROTTLE]) > THROTTLE_DEAD_BAND_US;
        vehicle->throttle_moved = beyond ? (uint8_t)(vehicle->throttle_moved + 1) : 0;
        moved = vehicle->throttle_moved >= THROTTLE_MOVED_PULSES;
    }
    if (moved) enter(vehicle, MANUAL, HUMAN);
}

static void judge_signal(struct vehicle *vehicle, uint32_t now_ms) {
    for (uint8_t channel = STEERING; channel <= THROTTLE; channel++) {
        struct received *received = &vehicle->received[channel];
        if (received->present && now_ms - received->at_ms > SIGNAL_TIMEOUT_MS) received->present = false;
    }
}

static bool has_signal(const struct vehicle *vehicle) {
    return vehicle->received[STEERING].present && vehicle->received[THROTTLE].present;
}

static enum result arm(struct vehicle *vehicle, uint32_t now_ms) {
    if (vehicle->state == AUTONOMOUS) return DONE; /* the host repeats itself: renews nothing */
    judge_signal(vehicle, now_ms);
    if (!has_signal(vehicle)) return REFUSED_NO_SIGNAL;
    if (distance(vehicle->received[THROTTLE].pulse_us, THROTTLE_NEUTRAL_US) > THROTTLE_DEAD_BAND_US)
        return REFUSED_STICK;
    vehicle->rest_us[STEERING] = vehicle->received[STEERING].pulse_us;
    vehicle->rest_us[THROTTLE] = vehicle->received[THROTTLE].pulse_us;
    vehicle->commanded_ms = now_ms;
    enter(vehicle, AUTONOMOUS, ARMED);
    return DONE;
}

static enum result drive(struct vehicle *vehicle, const struct command *command, uint32_t now_ms) {
    if (!within(command->steering_us, STEERING_MIN_US, STEERING_MAX_US) ||
        !within(command->throttle_us, THROTTLE_MIN_US, THROTTLE_MAX_US)) {
        count(&vehicle->out_of_range);
        return OUT_OF_RANGE;
    }
    if (vehicle->state != AUTONOMOUS) return IGNORED;
    vehicle->wanted_us[STEERING] = (uint16_t)command->steering_us;
    vehicle->wanted_us[THROTTLE] = (uint16_t)command->throttle_us;
    vehicle->commanded_ms = now_ms;
    return DONE;
}

void vehicle_command(struct vehicle *vehicle, const struct command *command, uint32_t now_ms) {
    /* What came too late must not be saved by what comes now. */
    vehicle_tick(vehicle, now_ms);
    uint32_t ahead = command->sequence - vehicle->sequence;
    if (command->boot != vehicle->boot || !within(ahead, 1, SEQUENCE_WINDOW)) {
        count(&vehicle->old_commands);
        vehicle->result = OLD;
        return;
    }
    vehicle->sequence = command->sequence;
    if (command->kind == COMMAND_ARM) {
        vehicle->result = (char)arm(vehicle, now_ms);
    } else if (command->kind == COMMAND_DRIVE) {
        vehicle->result = (char)drive(vehicle, command, now_ms);
    } else if (vehicle->state == AUTONOMOUS) {
        enter(vehicle, STOPPED, HOST_NEUTRAL);
        vehicle->result = DONE;
    } else {
        vehicle->result = IGNORED; /* in manual the car is the human's */
    }
}

void vehicle_tick(struct vehicle *vehicle, uint32_t now_ms) {
    judge_signal(vehicle, now_ms);
    if (vehicle->state == AUTONOMOUS) {
        if (!has_signal(vehicle))
            enter(vehicle, STOPPED, NO_SIGNAL);
        else if (now_ms - vehicle->commanded_ms >= COMMAND_TIMEOUT_MS)
            enter(vehicle, STOPPED, TIMEOUT);
    }
    if (vehicle->state == AUTONOMOUS) {
        vehicle->steering_us = vehicle->wanted_us[STEERING];
        vehicle->throttle_us = vehicle->wanted_us[THROTTLE];
    } else if (vehicle->state == MANUAL && has_signal(vehicle)) {
        vehicle->steering_us = vehicle->received[STEERING].pulse_us;
        vehicle->throttle_us = vehicle->received[THROTTLE].pulse_us;
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
    line_number(line, vehicle->steering_us);
    line_number(line, vehicle->throttle_us);
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
