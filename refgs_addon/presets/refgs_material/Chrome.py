base_color = (0.55, 0.556, 0.554, 1.0)
color_amount = 1.0
metallic = 1.0
metallic_amount = 1.0
roughness = 0.02
roughness_amount = 1.0
