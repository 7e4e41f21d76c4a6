print("st")
