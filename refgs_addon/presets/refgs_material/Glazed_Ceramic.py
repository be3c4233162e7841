base_color = (0.8, 0.78, 0.72, 1.0)
color_amount = 1.0
metallic = 0.0
metallic_amount = 1.0
roughness = 0.08
roughness_amount = 1.0
