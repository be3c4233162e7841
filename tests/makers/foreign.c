// Call functions of a library of kernels as told on the standard input, for foreign.py. All numbers are int64, in the machine's order.
//
// A request is a length and a function's name. Then either a count of integers and the integers: the answer is the result. Or -1, the
// size of a structure and its bytes; the count of buffers, and of each its size and bytes; the count of pointers in the structure, and
// of each its place there, its buffer and the place in that. The answer is the structure and the buffers after the call.
#include <stdint.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#ifdef _WIN32
#include <fcntl.h>
#include <io.h>
#include <windows.h>
#else
#include <dlfcn.h>
#endif

static void take(void* to, int64_t bytes) {
  if (fread(to, 1, bytes, stdin) != (size_t)bytes) exit(0);  // the input has ended
}

static int64_t number(void) {
  int64_t n;
  take(&n, sizeof n);
  return n;
}

static char* bytes(int64_t size) {  // aligned as torch's memory
  char* memory = malloc(size + 128);
  memory += 64 - (uintptr_t)memory % 64;
  take(memory, size);
  return memory;
}

int main(int count, char** words) {
#ifdef _WIN32
  _setmode(0, _O_BINARY), _setmode(1, _O_BINARY);
  HMODULE library = LoadLibraryA(words[1]);
#else
  void* library = dlopen(words[1], RTLD_NOW);
#endif
  if (count != 2 || !library) return fprintf(stderr, "cannot load %s\n", words[1]), 1;
  for (;;) {
    char name[256] = "";
    take(name, number());
#ifdef _WIN32
    void* function = (void*)GetProcAddress(library, name);
#else
    void* function = dlsym(library, name);
#endif
    if (!function) return fprintf(stderr, "no function %s\n", name), 1;
    int64_t integers = number();
    if (integers >= 0) {
      int64_t n[4] = {0};
      take(n, 8 * integers);
      n[0] = ((int64_t(*)(int64_t, int64_t, int64_t, int64_t))function)(n[0], n[1], n[2], n[3]);
      fwrite(n, 8, 1, stdout);
    } else {
      int64_t size = number();
      char* work = bytes(size);
      int64_t buffers = number();
      char** memory = malloc(8 * buffers + 8);
      int64_t* sizes = malloc(8 * buffers + 8);
      for (int64_t i = 0; i < buffers; i++) sizes[i] = number(), memory[i] = bytes(sizes[i]);
      for (int64_t pointers = number(); pointers > 0; pointers--) {
        int64_t at = number(), buffer = number(), offset = number();
        char* target = memory[buffer] + offset;
        memcpy(work + at, &target, 8);
      }
      ((void (*)(void*))function)(work);
      fwrite(work, 1, size, stdout);
      for (int64_t i = 0; i < buffers; i++) fwrite(memory[i], 1, sizes[i], stdout);
    }
    fflush(stdout);
  }
}
