"""Back ends: the text of a program in C++, CUDA C++ and C99."""
