#include "board.h"

#include <Arduino.h>
#include <avr/eeprom.h>
#include <avr/interrupt.h>
#include <avr/io.h>
#include <avr/sleep.h>
#include <avr/wdt.h>
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

/* ---- pulses out: Timer1 (steering, D10) and Timer2 (throttle, D3), both fast PWM up to OCRnA ------------------- */

static const uint16_t STEERING_TICKS = 42632; /* 21316 us of 0.5 us; the timer is also the clock */
static const uint8_t THROTTLE_TICKS = 254;    /* 1016 us of 4 us */

void pulses_begin() {
    /* Stopped and in normal mode first: only there OCRnx take effect at once instead of with the next period. */
    TCCR1A = 0;
    TCCR1B = 0;
    TIMSK1 = 0;
    TCNT1 = 0;
    OCR1A = STEERING_TICKS - 1;
    OCR1B = STEERING_NEUTRAL_US * 2 - 1;
    TCCR2A = 0;
    TCCR2B = 0;
    TIMSK2 = 0;
    ASSR = 0;
    TCNT2 = 0;
    OCR2A = THROTTLE_TICKS - 1;
    OCR2B = THROTTLE_NEUTRAL_US / 4 - 1;
    TCCR2A = _BV(COM2B1) | _BV(WGM21) | _BV(WGM20);
    TCCR2B = _BV(WGM22) | _BV(CS22); /* 16 MHz / 64 */
    TCCR1A = _BV(COM1B1) | _BV(WGM11) | _BV(WGM10);
    TCCR1B = _BV(WGM13) | _BV(WGM12) | _BV(CS11) | _BV(ICNC1) | _BV(ICES1); /* 16 MHz / 8 */
}

void pulses_set(uint16_t steering_us, uint16_t throttle_us) {
    if (steering_us < RECEIVER_STEERING_MIN_US || steering_us > RECEIVER_STEERING_MAX_US ||
        throttle_us < RECEIVER_THROTTLE_MIN_US || throttle_us > RECEIVER_THROTTLE_MAX_US) {
        steering_us = STEERING_NEUTRAL_US;
        throttle_us = THROTTLE_NEUTRAL_US;
    }
    uint16_t steering = (uint16_t)(steering_us * 2 - 1);
    uint8_t throttle = (uint8_t)((throttle_us + 2) / 4 - 1);
    /* 16-bit registers share one temporary byte, which the capture's interrupt uses as well. */
    ATOMIC_BLOCK(ATOMIC_RESTORESTATE) {
        if (OCR1B != steering) OCR1B = steering;
        OCR2B = throttle;
    }
}

/* ---- pulses in: steering on D2 (INT0), throttle on D8 (ICP1); and the clock --------------------------------------- */

/* Nothing but these interrupts may delay INT0 by more than about 3 us: a pulse that is measured by software is as good
 * as that. So the core's Timer0 is off, Timer1 is the only clock, and the longer interrupts let INT0 in. */
static volatile uint32_t period_start; /* of Timer1's period, in its ticks of 0.5 us; wraps after 36 minutes */

ISR(TIMER1_OVF_vect) { period_start += STEERING_TICKS; }

EMPTY_INTERRUPT(TIMER2_OVF_vect) /* wakes loop() every 1016 us */

/* Ticks at which TCNT1 was `tick`, at most half a period ago. With interrupts off. */
static inline uint32_t ticks_at(uint16_t tick) {
    uint32_t start = period_start;
    if ((TIFR1 & _BV(TOV1)) && tick < STEERING_TICKS / 2) start += STEERING_TICKS;
    return start + tick;
}

uint32_t clock_ms() {
    static uint32_t counted, ms;
    uint32_t now = 0;
    ATOMIC_BLOCK(ATOMIC_RESTORESTATE) { now = ticks_at(TCNT1); }
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
    bool overflow = (TIFR1 & _BV(TOV1)) && count < STEERING_TICKS / 2;
    uint32_t start = period_start;
    TCCR1B ^= _BV(ICES1); /* wait for the other edge */
    TIFR1 = _BV(ICF1);    /* as the datasheet asks after a change of edge */
    bool missed = high != bool(PINB & _BV(PINB0)); /* the other edge is over already: wait for this one again */
    if (missed) TCCR1B ^= _BV(ICES1);
    sei();
    if (overflow) start += STEERING_TICKS;     /* of the period now */
    if (tick > count) start -= STEERING_TICKS; /* the edge was in the one before */
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
    TIMSK2 = _BV(TOIE2);
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
