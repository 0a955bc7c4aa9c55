/* The firmware's memory subsystem, which here keeps the handlers that were registered. */
#pragma once
#include <stdbool.h>
#include <stdint.h>

typedef enum { MEM_TYPE_APP = 0x18 } MemoryType_t;

typedef struct {
  MemoryType_t type;
  uint32_t (*getSize)(const uint8_t internal_id);
  bool (*getSerialNbr)(const uint8_t internal_id, const uint8_t max_length, uint8_t *len, uint8_t *buffer);
  bool (*read)(const uint8_t internal_id, const uint32_t memAddr, const uint8_t readLen, uint8_t *buffer);
  bool (*write)(const uint8_t internal_id, const uint32_t memAddr, const uint8_t writeLen, const uint8_t *buffer);
  uint8_t internal_id;
} MemoryHandlerDef_t;

const MemoryHandlerDef_t *memories[2];
void memoryRegisterHandler(const MemoryHandlerDef_t *handlerDef);

#ifndef FIRMWARE_ELSEWHERE
void memoryRegisterHandler(const MemoryHandlerDef_t *handlerDef) { memories[memories[0] != 0] = handlerDef; }
#endif
