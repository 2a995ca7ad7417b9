// @NODE@ behind the link of softrig: the computer sends the inputs of each tick over the serial port, the board answers.
// Open this folder in the Arduino IDE, choose the board and its port, and upload. Written by `softrig export arduino`.
#include "@NODE@_link.h"

static @NODE@_link board;

static void put(uint8_t byte)
{
    Serial.write(byte);
}

static uint32_t now()
{
    return micros();
}

void setup()
{
    Serial.begin(@BAUD@);
    @NODE@_link_init(&board, put, now);
}

void loop()
{
    while (Serial.available() > 0) {
        @NODE@_link_take(&board, (uint8_t)Serial.read());
    }
}
