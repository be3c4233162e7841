base_color = (0.02, 0.02, 0.02, 1.0)
color_amount = 1.0
metallic = 0.0
metallic_amount = 1.0
roughness = 0.9
roughness_amount = 1.0
