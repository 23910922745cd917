#include "board.h"

#include <Arduino.h>
#include <avr/eeprom.h>
#include <avr/interrupt.h>
#include <avr/io.h>
#include <avr/sleep.h>
#include <avr/wdt.h>
#include <string.h>
#include <util/atomic.h>

#if !defined(__AVR_ATmega328P__) || F_CPU != 16000000L
#error "rover: written for an ATmega328P at 16 MHz (Arduino Uno or Nano)"
#endif

/* ---- reset ---------------------------------------------------------------------------------------------------- */

static uint8_t reset_flags __attribute__((section(".noinit")));

/* Before C is set up: after a watchdog reset the watchdog still runs, at 16 ms. The servo pins go low, which is no
 * pulse; the receiver's get pull-ups, so that one that is not plugged in gives no edges. */
extern "C" void before_main(void) __attribute__((naked, used, section(".init3")));
extern "C" void before_main(void) {
    PORTB = _BV(PORTB0);
    PORTD = _BV(PORTD2);
    DDRB = _BV(DDB2);
    DDRD = _BV(DDD3);
    reset_flags = MCUSR;
    MCUSR = 0;
    wdt_disable();
}

char reset_cause() {
    if (reset_flags & _BV(WDRF)) return 'w';
    if (reset_flags & _BV(BORF)) return 'b'; /* brown-out and power-on set each other's flag; a dip is worth knowing */
    if (reset_flags & _BV(EXTRF)) return 'e';
    return reset_flags & _BV(PORF) ? 'p' : '-';
}

uint16_t boot_number() {
    uint16_t *const kept = 0; /* the first two bytes of the EEPROM */
    uint16_t number = (uint16_t)(eeprom_read_word(kept) + 1);
    eeprom_update_word(kept, number);
    return number;
}

void watchdog_begin() { wdt_enable(WDTO_60MS); }
void watchdog_feed() { wdt_reset(); }

/* ---- the car ---------------------------------------------------------------------------------------------------- */

/* Behind the boot's number in the EEPROM. The version is erased before anything else is written and comes last, so that
 * a power cut leaves the old car or none; the CRC is for cells that forget. */
static struct kept {
    uint8_t version;
    struct car car;
    uint32_t check;
} kept; /* what is there, or is being written */
static uint8_t *const KEPT = (uint8_t *)2;
static const uint8_t VERSION = 1, ERASED = 0xFF;

const struct car *car_kept() {
    eeprom_read_block(&kept, KEPT, sizeof kept);
    if (kept.version != VERSION || kept.check != ~car_id(&kept.car) || !car_allowed(&kept.car)) kept = {};
    return &kept.car;
}

void car_keep(const struct car *car) {
    static uint8_t left; /* writes; a byte takes the chip 3.4 ms */
    if (memcmp(&kept.car, car, sizeof *car)) {
        kept = {VERSION, *car, ~car_id(car)};
        left = sizeof kept + 1;
    }
    if (!left || !eeprom_is_ready()) return;
    left--;
    uint8_t at = left == sizeof kept ? 0 : left, byte = left == sizeof kept ? ERASED : ((const uint8_t *)&kept)[at];
    if (eeprom_read_byte(KEPT + at) != byte) eeprom_write_byte(KEPT + at, byte);
}

/* ---- pulses out: Timer1 (steering, D10), fast PWM up to OCR1A, and Timer2 (throttle, D3) --------------------------- */

/* Timer2 counts 4 us to 256. A fast throttle's period fits in that: fast PWM up to OCR2A. A slow one's takes up to 25
 * rounds, in normal mode: each edge is a compare match, made by hardware; after each match an interrupt, which has half a
 * millisecond for it, sets the next. Ticks are Timer1's of 0.5 us, steps Timer2's of 4. */
static const uint16_t STEP_US = 4, ROUND = 256, HALF_ROUND = 128;

static volatile uint32_t period_start;   /* of Timer1's period, in its ticks of 0.5 us; wraps after 36 minutes */
static volatile uint16_t steering_ticks; /* of the present period of Timer1, which is also the clock */
static uint16_t throttle_period;         /* us, of Timer2 now */
static uint16_t throttle_neutral;        /* steps, of that car */
static bool fast;
static volatile uint16_t slow_period, slow_high; /* steps; from the next rising edge on */
static volatile uint16_t slow_low, slow_left;    /* of the period that is on; from the next match to the next edge */
static volatile bool slow_rises;                 /* whether the next edge rises */

/* Timer2, from its start: a throttle's neutral, if the pin is its. The pin is low, and interrupts are off. */
static void throttle_begin(const struct car *car, bool pin) {
    const struct servo *throttle = &car->servos[THROTTLE];
    throttle_period = throttle->period_us;
    throttle_neutral = throttle->neutral_us / STEP_US;
    fast = throttle_is_fast(car);
    TCCR2A = 0; /* stopped and in normal mode first, because only then OCR2x take effect at once */
    TCCR2B = 0;
    TIMSK2 = 0;
    ASSR = 0;
    TCNT2 = 0;
    if (fast) {
        OCR2A = (uint8_t)(throttle->period_us / STEP_US - 1);
        OCR2B = (uint8_t)(throttle_neutral - 1);
        TCCR2A = (pin ? _BV(COM2B1) : 0) | _BV(WGM21) | _BV(WGM20);
        TCCR2B = _BV(WGM22) | _BV(CS22); /* 16 MHz / 64 */
        TIMSK2 = _BV(TOIE2);
        return;
    }
    slow_period = throttle->period_us / STEP_US;
    slow_high = throttle_neutral;
    slow_left = 0; /* the first match is the first edge */
    slow_rises = true;
    OCR2B = HALF_ROUND - 1;
    TIFR2 = _BV(OCF2B);
    TCCR2A = _BV(COM2B1) | _BV(COM2B0); /* set at the match */
    TIMSK2 = _BV(OCIE2B);
    TCCR2B = _BV(CS22);
}

void pulses_begin(const struct car *car) {
    bool known = car->servos[STEERING].period_us;
    if (!known) car = &DEFAULT_CAR; /* its timers run, as clock and to wake loop(), without the pins */
    TCCR1A = 0;
    TCCR1B = 0;
    TIMSK1 = 0;
    TCNT1 = 0;
    steering_ticks = (uint16_t)(car->servos[STEERING].period_us * 2);
    OCR1A = steering_ticks - 1;
    OCR1B = car->servos[STEERING].neutral_us * 2 - 1;
    throttle_begin(car, known);
    if (!known) throttle_period = 0; /* any car's is another */
    TCCR1A = (known ? _BV(COM1B1) : 0) | _BV(WGM11) | _BV(WGM10);
    TCCR1B = _BV(WGM13) | _BV(WGM12) | _BV(CS11) | _BV(ICNC1) | _BV(ICES1); /* 16 MHz / 8 */
}

/* Runs just after a match of the slow throttle. It lets other interrupts in at once, as the next match is not near. */
ISR(TIMER2_COMPB_vect, ISR_NOBLOCK) {
    bool rises = slow_rises;
    uint16_t left = slow_left;
    if (!left) { /* it was an edge */
        if (rises) {
            uint16_t high = slow_high;
            slow_low = slow_period - high;
            left = high;
        } else {
            left = slow_low;
        }
        slow_rises = rises = !rises;
    }
    uint16_t step = left <= ROUND ? left : left <= ROUND + HALF_ROUND ? HALF_ROUND : ROUND;
    left -= step;
    slow_left = left;
    /* At the match the pin does what it is told, which is what it does already until the match is the edge. */
    TCCR2A = rises == !left ? _BV(COM2B1) | _BV(COM2B0) : _BV(COM2B1);
    OCR2B += (uint8_t)step;
}

/* Another car's, as soon as no pulse is on: one that is cut short could be another one's full reverse. */
static void throttle_change(const struct car *car) {
    ATOMIC_BLOCK(ATOMIC_RESTORESTATE) {
        if (!(PIND & _BV(PIND3))) {
            TCCR2A = 0; /* the pin stays low */
            throttle_begin(car, true);
        }
    }
}

/* Another car's period of Timer1 begins with an overflow, and the clock has to know which one that was. */
static void steering_change(uint16_t ticks) {
    static uint16_t next_ticks;
    static uint32_t before;
    ATOMIC_BLOCK(ATOMIC_RESTORESTATE) {
        if (next_ticks) { /* was written to OCR1A, in the period that began at `before` */
            if (period_start != before) {
                steering_ticks = next_ticks;
                next_ticks = 0;
            }
        } else if (!(TIFR1 & _BV(TOV1)) && TCNT1 < steering_ticks - 1000) {
            next_ticks = ticks;
            before = period_start;
            OCR1A = ticks - 1;
        }
    }
}

void pulses_set(const struct car *car, uint16_t steering_us, uint16_t throttle_us) {
    if (!car->servos[STEERING].period_us) return;
    const struct servo *throttle = &car->servos[THROTTLE];
    bool is_fast = throttle_is_fast(car);
    if (steering_us < PULSE_MIN_US || steering_us > PULSE_MAX_US ||
        throttle_us < (is_fast ? FAST_PULSE_MIN_US : PULSE_MIN_US) ||
        throttle_us > (is_fast ? FAST_PULSE_MAX_US : PULSE_MAX_US)) {
        steering_us = car->servos[STEERING].neutral_us;
        throttle_us = throttle->neutral_us;
    }
    uint16_t ticks = (uint16_t)(car->servos[STEERING].period_us * 2);
    if (ticks != steering_ticks) steering_change(ticks);
    if (throttle_period != throttle->period_us) throttle_change(car);
    uint16_t steering = (uint16_t)(steering_us * 2 - 1), steps = (uint16_t)(throttle_us + 2) / STEP_US;
    if (throttle_period != throttle->period_us) steps = throttle_neutral; /* a pulse is still on: another turn */
    /* 16-bit registers share one temporary byte, which the capture's interrupt uses as well. */
    ATOMIC_BLOCK(ATOMIC_RESTORESTATE) {
        if (OCR1B != steering) OCR1B = steering;
    }
    TCCR1A |= _BV(COM1B1); /* with the first car: the pin rises at the next period, with OCR1B of then */
    if (fast) {
        OCR2B = (uint8_t)(steps - 1);
    } else if (slow_high != steps) {
        ATOMIC_BLOCK(ATOMIC_RESTORESTATE) { slow_high = steps; }
    }
}

/* ---- pulses in: steering on D2 (INT0), throttle on D8 (ICP1); and the clock --------------------------------------- */

/* Nothing but these interrupts may delay INT0 by more than about 3 us: a pulse that is measured by software is as good
 * as that. So the core's Timer0 is off, Timer1 is the only clock, and the longer interrupts let INT0 in. */
/* period_start += steering_ticks. In C it saves registers for a microsecond longer, which INT0 has not. */
ISR(TIMER1_OVF_vect, ISR_NAKED) {
    asm volatile("push r24 \n in r24, %2 \n push r24 \n push r25 \n"
                 "lds r24, %0 \n lds r25, %1 \n add r24, r25 \n sts %0, r24 \n"
                 "lds r24, %0+1 \n lds r25, %1+1 \n adc r24, r25 \n sts %0+1, r24 \n"
                 "ldi r25, 0 \n" /* leaves the carry */
                 "lds r24, %0+2 \n adc r24, r25 \n sts %0+2, r24 \n"
                 "lds r24, %0+3 \n adc r24, r25 \n sts %0+3, r24 \n"
                 "pop r25 \n pop r24 \n out %2, r24 \n pop r24 \n reti"
                 :: "i"(&period_start), "i"(&steering_ticks), "I"(_SFR_IO_ADDR(SREG)));
}

EMPTY_INTERRUPT(TIMER2_OVF_vect) /* wakes loop() every 1016 us; of a slow throttle, its matches do */

/* The ticks when TCNT1 was `tick`, at most half a period ago. Call it with interrupts off. */
static inline uint32_t ticks_at(uint16_t tick) {
    uint32_t start = period_start;
    if ((TIFR1 & _BV(TOV1)) && tick < steering_ticks / 2) start += steering_ticks;
    return start + tick;
}

uint32_t clock_ms() {
    static uint32_t counted, ms;
    uint32_t now = 0;
    uint16_t tick = 0;
    uint8_t flags = 0;
    ATOMIC_BLOCK(ATOMIC_RESTORESTATE) { /* as ticks_at(), but INT0 waits for no more than the reading */
        tick = TCNT1;
        flags = TIFR1;
        now = period_start;
    }
    if (flags & _BV(TOV1) && tick < steering_ticks / 2) now += steering_ticks;
    now += tick;
    for (; (int32_t)(now - counted) >= 2000; counted += 2000) ms++; /* signed: never a leap, whatever was misread */
    return ms;
}

struct capture {
    uint32_t rise, period; /* ticks */
    uint16_t pulse_us, period_us;
    bool high, fresh;
};
static volatile struct capture captures[2];

static inline uint16_t microseconds(uint32_t ticks) {
    return ticks >= 2UL * UINT16_MAX ? UINT16_MAX : (uint16_t)((ticks + 1) / 2);
}

static inline void edge(volatile struct capture *capture, bool high, uint32_t now) {
    if (high) {
        capture->period = now - capture->rise;
        capture->rise = now;
    } else if (capture->high) {
        capture->pulse_us = microseconds(now - capture->rise);
        capture->period_us = microseconds(capture->period);
        capture->fresh = true;
    }
    capture->high = high;
}

ISR(INT0_vect) {
    uint16_t tick = TCNT1;
    edge(&captures[STEERING], PIND & _BV(PIND2), ticks_at(tick));
}

/* A throttle edge has its time in ICR1 and can wait; INT0's has not. So this lets other interrupts in at once, but not
 * itself. (In C, saving registers alone would keep INT0 waiting for 3 us.) */
ISR(TIMER1_CAPT_vect, ISR_NAKED) {
    asm volatile("push r24 \n ldi r24, %1 \n sts %0, r24 \n pop r24 \n sei \n jmp __vector_throttle_edge"
                 :: "i"(_SFR_MEM_ADDR(TIMSK1)), "i"(_BV(TOIE1)));
}

extern "C" void __vector_throttle_edge(void) __attribute__((signal, used, externally_visible));
extern "C" void __vector_throttle_edge(void) {
    cli(); /* INT0 reads a 16-bit register too */
    bool high = TCCR1B & _BV(ICES1);
    uint16_t tick = ICR1, count = TCNT1;
    uint16_t ticks = steering_ticks; /* of the period now, or of the one before if its overflow still waits */
    bool overflow = (TIFR1 & _BV(TOV1)) && count < ticks / 2;
    uint32_t start = period_start;
    TCCR1B ^= _BV(ICES1); /* wait for the other edge */
    TIFR1 = _BV(ICF1);    /* as the datasheet asks after a change of edge */
    bool missed = high != bool(PINB & _BV(PINB0)); /* the other edge is over already: wait for this one again */
    if (missed) TCCR1B ^= _BV(ICES1);
    sei();
    if (overflow) start += ticks;     /* of the period now */
    if (tick > count) start -= ticks; /* the edge was in the one before */
    if (missed)
        captures[THROTTLE].high = false;
    else
        edge(&captures[THROTTLE], high, start + tick);
    cli(); /* until the return, or the next edge would begin inside of this one */
    TIMSK1 = _BV(ICIE1) | _BV(TOIE1);
}

void receiver_begin() {
    EICRA = _BV(ISC00); /* both edges of INT0 */
    EIFR = _BV(INTF0);
    EIMSK = _BV(INT0);
    TIFR1 = _BV(ICF1) | _BV(TOV1);
    TIMSK1 = _BV(ICIE1) | _BV(TOIE1);
    TIMSK0 = 0;
}

bool receiver_take(enum channel channel, uint16_t *pulse_us, uint16_t *period_us) {
    volatile struct capture *capture = &captures[channel];
    bool fresh = false;
    ATOMIC_BLOCK(ATOMIC_RESTORESTATE) {
        fresh = capture->fresh;
        capture->fresh = false;
        *pulse_us = capture->pulse_us;
        *period_us = capture->period_us;
    }
    return fresh;
}

/* ---- serial line: not the core's Serial, which waits when its buffer is full and hides lost bytes --------------- */

static volatile uint8_t in[128], in_head, in_tail, lost;
static volatile uint8_t out[256], out_head, out_tail; /* 256: uint8_t wraps by itself */

ISR(USART_RX_vect) {
    uint8_t status = UCSR0A, byte = UDR0;
    sei();
    if (status & (_BV(FE0) | _BV(DOR0)) && lost < UINT8_MAX) lost++;
    if (status & _BV(FE0)) return;
    uint8_t head = (uint8_t)((in_head + 1) % sizeof in);
    if (head == in_tail) {
        if (lost < UINT8_MAX) lost++;
        return;
    }
    in[in_head] = byte;
    in_head = head;
}

ISR(USART_UDRE_vect) {
    if (out_tail == out_head)
        UCSR0B &= (uint8_t)~_BV(UDRIE0);
    else
        UDR0 = out[out_tail++];
}

void serial_begin() {
    UCSR0A = _BV(U2X0);
    UBRR0 = 16; /* 117647 baud: 2.1 % above 115200, what every Uno does */
    UCSR0C = _BV(UCSZ01) | _BV(UCSZ00);
    UCSR0B = _BV(RXEN0) | _BV(TXEN0) | _BV(RXCIE0);
}

int serial_take() {
    if (in_tail == in_head) return -1;
    uint8_t byte = in[in_tail];
    in_tail = (uint8_t)((in_tail + 1) % sizeof in);
    return byte;
}

bool serial_put(const char *text, uint8_t length) {
    uint8_t room = (uint8_t)(out_tail - out_head - 1);
    if (length > room) return false;
    uint8_t head = out_head;
    while (length--) out[head++] = (uint8_t)*text++;
    out_head = head;
    ATOMIC_BLOCK(ATOMIC_RESTORESTATE) { UCSR0B |= _BV(UDRIE0); }
    return true;
}

uint8_t serial_lost() {
    uint8_t n = 0;
    ATOMIC_BLOCK(ATOMIC_RESTORESTATE) {
        n = lost;
        lost = 0;
    }
    return n;
}

/* ---- sleep ------------------------------------------------------------------------------------------------------ */

void rest() {
    set_sleep_mode(SLEEP_MODE_IDLE); /* timers and the serial line go on */
    cli();
    if (in_tail == in_head && !captures[STEERING].fresh && !captures[THROTTLE].fresh) {
        sleep_enable();
        sei(); /* takes effect after the next instruction: no interrupt can slip in before the sleep */
        sleep_cpu();
        sleep_disable();
    }
    sei();
}
